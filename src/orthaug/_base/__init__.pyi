from .errors import InputError as InputError
from .errors import RankError as RankError
from .errors import TrainingError as TrainingError
