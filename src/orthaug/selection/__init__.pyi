from .selecting import Selection as Selection
from .selecting import select as select
