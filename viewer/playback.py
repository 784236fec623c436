"""Which record of a job is shown. Pure logic: no viser, no HTTP."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Playback:
    """The index of the record that is shown, in a list of records that may still grow."""

    count: int = 0
    index: int = 0
    playing: bool = False
    live: bool = True
    """Whether the index moves on to each new record."""

    @property
    def at_end(self) -> bool:
        """Whether the newest record is shown."""
        return self.index >= self.count - 1

    def set_count(self, count: int) -> None:
        """Set the number of records; if live and not playing, show the newest one."""
        self.count = count
        if self.live and not self.playing:
            self.index = max(0, count - 1)
        self.index = min(self.index, max(0, count - 1))  # fewer than before: the job is tried again

    def go(self, index: int) -> None:
        """Show record `index`, clamped to those there are; at the newest one playback is live from now on."""
        self.index = max(0, min(index, self.count - 1))
        self.live = self.at_end

    def step(self, by: int) -> None:
        """Move by some records, and pause."""
        self.playing = False
        self.go(self.index + by)

    def toggle(self) -> None:
        """Play or pause; at the end, play from the start."""
        self.playing = not self.playing and self.count > 1
        # Played to the end, so that there is nothing left to play.
        if self.playing and self.at_end:
            self.go(0)

    def tick(self) -> None:
        """Show the next record if playing; pause at the end."""
        if self.playing:
            self.go(self.index + 1)
            self.playing = not self.at_end
