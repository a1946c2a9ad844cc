from .explanation import Explanation as Explanation
from .explanation import explain as explain
from .selecting import Selection as Selection
from .selecting import select as select
