from .dask_source import open_frame as open_frame
from .parquet_source import open_parquet as open_parquet
from .readers import read_record as read_record
from .record import Channel as Channel
from .record import Experiment as Experiment
from .record import Record as Record
from .regressors import Lags as Lags
