"""Which scenes are in which replica's memory, and where a job goes: decisions only, no clock, no processes.

The Ray engine and the simulation in `bench` run this same code. A job goes to the replica at which it is expected to
begin first, with the work that it causes there: jobs before it take `service_s` each, a scene that isn't there takes
its load, and one that has to go for it will be loaded again some time. So a job goes where its scene is. A scene whose
jobs find others before them again and again gets another copy, loaded beside; copies go as the least recently used.
Scenes in use are never dropped.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

_OTHERS = 8
"""Replicas without a scene that are looked at for it: one decision must not take long among a thousand."""


@dataclass(frozen=True, slots=True)
class PlacementConfig:
    """The budget of a replica, and what jobs and loads are assumed to take."""

    budget_bytes: int | None = None
    """Of the scenes in one replica; None: any number."""
    service_s: float = 0.1
    """A job's time: between the 45 and 122 ms of a photo on the cores of docs/accuracy.md."""
    load_s: float = 2.0
    """What loading takes beside reading: preparing a scene of the demo's size from its cache, with the first search."""
    load_bytes_per_s: float = 100e6
    """Reading and preparing, by what the scene takes of memory then."""

    crowded: float = 5.0
    """Jobs that those of a scene find before them, smoothed over some ten: beyond that it gets another copy. A burst of
    a dozen doesn't reach it."""
    smoothing: float = 0.1
    """Share of the latest job in that mean."""


@dataclass(slots=True)
class SceneCopy:
    """A scene in a replica's memory, or on its way there."""

    bytes: int
    """Expected ones until it is loaded."""
    ready: bool = False
    uses: int = 0
    """By jobs that run, or wait for it."""
    used: int = 0
    """When it was last chosen, in decisions."""
    pinned: bool = False
    """It has no file, and could not be loaded again."""


@dataclass(slots=True)
class _Replica:
    copies: dict[str, SceneCopy] = field(default_factory=dict)
    jobs: int = 0
    bytes: int = 0
    """Of all its scenes."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Where a job goes, and what has to be done for it."""

    replica: str
    load: tuple[str, ...]
    """Scenes to load there."""
    drop: tuple[str, ...]
    """Scenes to drop there before."""


class Placement:
    """The table of replicas and their scenes. Not safe for several threads."""

    def __init__(self, config: PlacementConfig) -> None:
        self._config = config
        self._replicas: dict[str, _Replica] = {}
        self._sizes: dict[str, int] = {}
        self._holders: dict[str, set[str]] = {}
        """The replicas of each scene: the table's other direction."""
        self._queues: dict[str, float] = {}
        """By scene: how many jobs a job of it found before it, smoothed."""
        self._decisions = 0

    # ------------------------------------------------------------------ what there is

    def add_replica(self, replica: str) -> None:
        """Make an empty replica known."""
        self._replicas[replica] = _Replica()

    def remove_replica(self, replica: str) -> None:
        """Forget a replica with all that it had; without effect if it isn't known."""
        gone = self._replicas.pop(replica, None)
        for scene in gone.copies if gone else ():
            self._holders[scene].discard(replica)

    def replicas(self) -> list[str]:
        """Return the replicas' names."""
        return list(self._replicas)

    def copies(self, scene: str) -> dict[str, SceneCopy]:
        """Return a scene's copies by replica."""
        return {name: self._replicas[name].copies[scene] for name in sorted(self._holders.get(scene, ()))}

    def scenes(self, replica: str) -> dict[str, SceneCopy]:
        """Return the scenes of a replica."""
        return self._replicas[replica].copies

    def jobs(self, replica: str) -> int:
        """Return how many jobs a replica has, running or waiting for their scenes there."""
        return self._replicas[replica].jobs

    def expect(self, scene: str, size: int) -> None:
        """Note what a scene will take of memory, until it is measured."""
        self._sizes.setdefault(scene, size)

    def forget(self, scene: str) -> None:
        """Forget a scene's size: another may have its name."""
        self._sizes.pop(scene, None)

    def size(self, scene: str) -> int:
        """Return what a scene takes, or is expected to; 0 where that isn't known."""
        return self._sizes.get(scene, 0)

    def could_hold(self, scenes: Iterable[str]) -> bool:
        """Return whether scenes fit together into an empty replica."""
        budget = self._config.budget_bytes
        return budget is None or sum(map(self.size, scenes)) <= budget

    # ------------------------------------------------------------------ decisions

    def choose(self, scenes: Sequence[str]) -> Choice | None:
        """Return where a job that needs all of these scenes should go; None if no replica has room for them now."""
        best = self._best(self._candidates(scenes), scenes)
        # In a fleet where all candidates are full of scenes in use, another may have room.
        return best or self._best(self._replicas, scenes)

    def _is_missed(self, scene: str) -> bool:
        """Return whether a scene would soon be loaded again if one copy of it went: it has no other, and is in use."""
        copies = self.copies(scene)
        # One load in so many jobs costs a tenth of what the jobs take.
        often = 10 * self._load_s(self.size(scene)) / self._config.service_s
        return len(copies) == 1 and self._decisions - max(copy.used for copy in copies.values()) < often

    def _candidates(self, scenes: Sequence[str]) -> list[str]:
        """Return the replicas that have any of the scenes, and some of the others that have the least to do."""
        there = set().union(*(self._holders.get(scene, ()) for scene in scenes))
        others = ((r.jobs, r.bytes, name) for name, r in self._replicas.items() if name not in there)
        return [*sorted(there), *(name for *_, name in heapq.nsmallest(_OTHERS, others))]

    def _best(self, names: Iterable[str], scenes: Sequence[str]) -> Choice | None:
        best: tuple[float, Choice] | None = None
        for name in names:
            replica = self._replicas[name]
            load = tuple(scene for scene in scenes if scene not in replica.copies)
            drop = self._to_drop(replica, load, scenes)
            if drop is None:
                continue
            cost = self._cost(replica, scenes, load, drop)
            if best is None or cost < best[0]:
                best = cost, Choice(name, load, drop)
        return best and best[1]

    def take(self, choice: Choice, scenes: Sequence[str]) -> None:
        """Carry out a choice in the table: drop, reserve, and count a job that uses all of the scenes there."""
        replica = self._replicas[choice.replica]
        self._decisions += 1
        for scene in choice.drop:
            self.dropped(choice.replica, scene)
        for scene in choice.load:
            self._put(choice.replica, scene, self.size(scene))
        for scene in scenes:
            replica.copies[scene].uses += 1
            replica.copies[scene].used = self._decisions
            before = self._queues.get(scene, 0.0)
            self._queues[scene] = before + self._config.smoothing * (replica.jobs - before)
        replica.jobs += 1

    def extra_copy(self, scene: str) -> Choice | None:
        """Return where another copy of a scene should be loaded because its jobs wait for each other; None: nowhere."""
        there = self.copies(scene)
        crowded = self._queues.get(scene, 0.0) > self._config.crowded
        if not crowded or not all(copy.ready for copy in there.values()):
            return None
        fewest = min((self._replicas[name].jobs for name in there), default=0)
        names = [name for name in self._candidates((scene,)) if name not in there]
        # No copy where jobs would wait as long.
        choice = self._best([name for name in names if self._replicas[name].jobs < fewest / 2], (scene,))
        if choice and any(self._is_missed(other) for other in choice.drop):
            return None
        if choice:
            self._queues[scene] = 0.0  # whether it was enough is seen anew
        return choice

    def release(self, name: str, scenes: Sequence[str]) -> None:
        """Count one job less that uses the scenes; without effect on a replica that is gone."""
        replica = self._replicas.get(name)
        if replica is None:
            return
        replica.jobs -= 1
        for scene in scenes:
            if copy := replica.copies.get(scene):
                copy.uses -= 1

    def loaded(self, name: str, scene: str, size: int, *, pinned: bool = False) -> tuple[str, ...]:
        """Note that a scene is in memory and what it takes; return what to drop where it takes more than expected."""
        replica = self._replicas[name]
        copy = self._put(name, scene, size)
        self._sizes[scene] = size
        copy.ready, copy.pinned = True, pinned
        over = self._to_drop(replica, (), (scene,)) or ()
        for other in over:
            self.dropped(name, other)
        return over

    def _put(self, name: str, scene: str, size: int) -> SceneCopy:
        """Enter a copy, or its size if it is there."""
        replica = self._replicas[name]
        copy = replica.copies.setdefault(scene, SceneCopy(0))
        replica.bytes += size - copy.bytes
        copy.bytes = size
        self._holders.setdefault(scene, set()).add(name)
        return copy

    def dropped(self, name: str, scene: str) -> None:
        """Note that a scene isn't in a replica's memory: its load failed, or it was taken out."""
        replica = self._replicas.get(name)
        if replica and (copy := replica.copies.pop(scene, None)):
            replica.bytes -= copy.bytes
            self._holders[scene].discard(name)

    # ------------------------------------------------------------------ what they rest on

    def _cost(self, replica: _Replica, scenes: Sequence[str], load: Sequence[str], drop: Sequence[str]) -> float:
        """Return the seconds until a job could begin there, and those of the loads that it causes."""
        fresh = [self.size(scene) for scene in load]
        waits = bool(load) or any(not replica.copies[scene].ready for scene in scenes)
        # Loads of a replica are made one after the other: who needs one waits for those before it.
        before = [copy.bytes for copy in replica.copies.values() if waits and not copy.ready]
        again = [replica.copies[scene].bytes for scene in drop]
        # A load counts twice, as time that the job waits and as work: to wait for one under way is better.
        return replica.jobs * self._config.service_s + sum(map(self._load_s, [*before, *fresh, *fresh, *again]))

    def _load_s(self, size: int) -> float:
        return self._config.load_s + size / self._config.load_bytes_per_s

    def _to_drop(self, replica: _Replica, load: Sequence[str], kept: Sequence[str]) -> tuple[str, ...] | None:
        """Return what has to go so that scenes fit beside the rest; None if they don't fit now."""
        budget = self._config.budget_bytes
        if budget is None:
            return ()
        over = replica.bytes + sum(map(self.size, load)) - budget
        if over <= 0:
            return ()
        idle = [
            name for name, c in replica.copies.items() if c.ready and not c.uses and not c.pinned and name not in kept
        ]
        idle.sort(key=lambda name: replica.copies[name].used)
        drop: list[str] = []
        for name in idle:
            if over <= 0:
                break
            over -= replica.copies[name].bytes
            drop.append(name)
        return tuple(drop) if over <= 0 or not load else None
