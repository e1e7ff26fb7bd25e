"""What stands in a file of a log, as tables by topic and run: the way into its readers.

Users read logs by a mapping of their columns, which says what they mean.
"""

from gpmpc.logs._formats import read_file
from gpmpc.logs._runs import split_into_runs

__all__ = ["read_file", "split_into_runs"]
