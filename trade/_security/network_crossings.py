"""Network crossings: what a gateway lets pass between one of its networks and the others."""

from collections.abc import Mapping, Sequence
from math import inf
from types import MappingProxyType
from typing import NamedTuple


class Crossing(NamedTuple):
    """What a gateway lets pass between one of its networks and the others."""

    offered: Sequence[str]
    """Groups whose services of this network the others see and call."""
    seen: Sequence[str]
    """Groups of the others that are visible and callable from this network."""
    offered_hz: Mapping[str, float] = MappingProxyType({})
    """Rate limits of streams of offered groups, in samples a second."""
    seen_hz: Mapping[str, float] = MappingProxyType({})


def crossings(
    exports: Mapping[str, Sequence[str]], limits: Mapping[str, Mapping[str, float]] = MappingProxyType({})
) -> dict[str, Crossing]:
    """Turns the exports of each network, by interface and with their rates, into what crosses at each.

    A group that several networks export is visible at the highest of their limits; each limit applies at its network.
    """
    made: dict[str, Crossing] = {}
    for name, groups in exports.items():
        others = [other for other in exports if other != name]
        seen: dict[str, float] = {}
        for other in others:
            for group in exports[other]:
                seen[group] = max(seen.get(group, 0.0), limits.get(other, {}).get(group, inf))
        seen_hz = {group: hz for group, hz in seen.items() if hz < inf}
        made[name] = Crossing(groups, sorted(seen), limits.get(name, {}), seen_hz)
    return made
