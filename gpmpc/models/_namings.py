"""What the states and inputs of a log may be called.

An entry is called by its column in the file, by the name that it has in the state, and,
where a signal has one entry only, by the signal's key in the mapping. A system may use
any of these.
"""

from collections.abc import Sequence
from typing import NamedTuple


class Namings(NamedTuple):
    """Ways to call the states, and the inputs; each names all of them, differently."""

    states: tuple[tuple[str, ...], ...] = ()  # n names each
    inputs: tuple[tuple[str, ...], ...] = ()  # m names each

    @property
    def first_states(self) -> tuple[str, ...]:
        """The first names of the states; none where there are none."""
        return next(iter(self.states), ())

    @property
    def first_inputs(self) -> tuple[str, ...]:
        """The first names of the inputs; none where there are none."""
        return next(iter(self.inputs), ())


NO_NAMINGS = Namings()


def order_by_name(
    own: Sequence[str], namings: Sequence[Sequence[str]]
) -> list[int] | None:
    """Returns where each own name stands among names, by the first that are the same.

    None where none are. Names such as "state.angle" count as "angle", on both sides,
    where whole names are not the same and these tell all entries apart.
    """
    plain_own = [_without_prefix(name) for name in own]
    for names in namings:
        plain = [_without_prefix(name) for name in names]
        for wanted, known in ((own, names), (plain_own, plain)):
            if len(set(known)) == len(known) and sorted(wanted) == sorted(known):
                return [list(known).index(name) for name in wanted]
    return None


def _without_prefix(name: str) -> str:
    """Returns a name behind its last dot."""
    return name.rpartition(".")[2]
