"""Episodes of a recording: its parts between two times, as frames at a fixed rate."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import msgspec

from trade.errors import ConfigurationError
from trade_gateway.recording._channels import LOCKS, JointStates, Lock, Locks
from trade_gateway.recording._motion import gaps, motion_of
from trade_gateway.recording._reader import RecordedMessage
from trade_gateway.recording._sources import within

_decode: Final = msgspec.json.Decoder(Locks).decode
_ROUNDING: Final = 1e-6


class Span(NamedTuple):
    """A part of a recording, in seconds since the epoch."""

    task: str
    from_s: float = -math.inf
    until_s: float = math.inf


class Episode(NamedTuple):
    """The positions of all joints at a fixed rate."""

    task: str
    states: Sequence[Sequence[float]]
    """For each frame, the angle of each joint in rad; the width of a gripper in m."""
    actions: Sequence[Sequence[float]]
    """For each frame, the state one frame later, as recordings contain no commands."""


def locked(entries: Iterable[RecordedMessage], joints: Sequence[str]) -> list[Span]:
    """The times of locks over any of the joints, each with the lock's purpose."""
    open_: dict[tuple[str, str], Span] = {}
    """By owner and purpose: a lock over several containers is one."""
    found: list[Span] = []
    looked_s = last_s = -math.inf
    for entry in entries:
        last_s = max(last_s, entry.stamp_ns / 1e9)
        if entry.topic != LOCKS.topic:
            continue
        now = _held(_decode(entry.data), joints)
        for key, span in list(open_.items()):
            taken_again_s = now.get(key, math.inf)
            if taken_again_s > looked_s:
                found.append(span._replace(until_s=min(taken_again_s, last_s)))
                del open_[key]
        for key, since_s in now.items():
            open_.setdefault(key, Span(key[1], since_s))
        looked_s = entry.stamp_ns / 1e9
    found += [span._replace(until_s=last_s) for span in open_.values()]
    return sorted(found, key=lambda span: span.from_s)


def _held(locks: Locks, joints: Sequence[str]) -> dict[tuple[str, str], float]:
    """The start of each lock over any of the joints, by owner and purpose."""
    held: dict[tuple[str, str], float] = {}
    for lock in locks.locks:
        if _over(lock, joints):
            key = lock.owner, lock.purpose
            held[key] = min(lock.since_s, held.get(key, math.inf))
    return held


def _over(lock: Lock, joints: Sequence[str]) -> bool:
    return any(within(joint, lock.resources) for joint in joints) if lock.resources else False


def episodes(
    states: Mapping[str, Sequence[JointStates]],
    spans: Sequence[Span],
    fps: int,
    callback: Callable[[Span, str], None],
) -> Iterator[Episode]:
    """Returns the measurements of each span, linearly interpolated.

    Args:
        states: measurements by group; each frame has all their joints, in this order.
        spans: the parts to return.
        fps: frames per second.
        callback: called with a span that is cut where a joint moved unmeasured, or skipped for too few measurements,
            and with the reason.
    """
    for span in spans:
        try:
            parts = list(_parts(_within(states, span), span, callback))
        except ConfigurationError as problem:
            callback(span, f"is left out: {problem.problem}")
            continue
        for part in parts:
            try:
                found = _episode(_within(states, part), part, fps)
            except ConfigurationError as problem:
                what = "is left out" if part == span else "is left out in part"
                callback(span, f"{what}: {problem.problem}")
            else:
                yield found


def _within(states: Mapping[str, Sequence[JointStates]], span: Span) -> dict[str, list[JointStates]]:
    return {
        group: [one for one in measured if span.from_s <= min(one.stamp_s) <= span.until_s]
        for group, measured in states.items()
    }


def _parts(
    states: Mapping[str, Sequence[JointStates]], span: Span, callback: Callable[[Span, str], None]
) -> Iterator[Span]:
    """Removes from a span the times at which a joint moved unmeasured."""
    began_s = min((min(one.stamp_s) for measured in states.values() for one in measured), default=0.0)
    from_s = span.from_s
    for gap in sorted(gap for group, measured in states.items() for gap in gaps(group, measured)):
        at = f"from {gap.from_s - began_s:.1f} to {gap.until_s - began_s:.1f} s"
        callback(span, f"is cut: {gap.joint} moved and was not measured {at}")
        if gap.from_s > from_s:
            yield span._replace(from_s=from_s, until_s=gap.from_s)
        from_s = max(from_s, gap.until_s)
    yield span._replace(from_s=from_s)


def _episode(states: Mapping[str, Sequence[JointStates]], span: Span, fps: int) -> Episode:
    motions = [motion_of(group, measured) for group, measured in states.items()]
    tracks = [(motion.began_s, track) for motion in motions for track in motion.tracks]
    from_s = max(began_s + track.times_s[0] for began_s, track in tracks)
    until_s = min(began_s + track.times_s[-1] for began_s, track in tracks)
    count = int((until_s - from_s) * fps + _ROUNDING)
    if count < 1:
        raise ConfigurationError(where="recording", problem=f"it has less than one frame at {fps} a second")
    places = [[track.at(from_s + number / fps - began_s) for began_s, track in tracks] for number in range(count + 1)]
    return Episode(span.task, places[:-1], places[1:])
