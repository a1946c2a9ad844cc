from .covariance import prediction_std as prediction_std
from .measures import Samples as Samples
from .measures import Symmetrized as Symmetrized
from .measures import Training as Training
from .measures import Uniform as Uniform
from .measures import Weighted as Weighted
