from .choice import Selection as Selection
from .explanation import Explanation as Explanation
from .explanation import explain as explain
from .selecting import select as select
