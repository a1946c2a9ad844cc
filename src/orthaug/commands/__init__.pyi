from .cli import main as main
from .library import fit_spec as fit_spec
from .library import load_spec as load_spec
