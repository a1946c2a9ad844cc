from .baseline import Baseline as Baseline
from .baseline import Parameter as Parameter
from .baseline import Term as Term
from .excitation import identifiability as identifiability
from .parameters import PhysicalParameter as PhysicalParameter
from .parameters import PhysicsMap as PhysicsMap
