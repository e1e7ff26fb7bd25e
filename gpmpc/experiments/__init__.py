"""Published results, one small module each: what is claimed, which trials it needs, how its tables are computed.

The modules stand in ``experiments/`` of a checkout, and in a wheel beside this file.
"""

from pathlib import Path

_IN_CHECKOUT = Path(__file__).resolve().parents[2] / "experiments"
if not Path(__file__).with_name("tables.py").exists():
    __path__.append(str(_IN_CHECKOUT))
