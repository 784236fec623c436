"""What a client is advised to send: a rate that is used, and frames as large as they are of use."""

from __future__ import annotations

from dataclasses import dataclass, field

MAX_USEFUL_PX, GOOD_PX, MIN_USEFUL_PX = 832, 640, 320
"""Long sides of frames: larger ones are reduced after they were decoded; in smaller ones too little can be seen."""
_WINDOW = 30
"""Used frames between two looks at the rate."""
_SLACK = 1.25
"""Ratio of rates up to which nothing is advised: queues fill and empty for other reasons, too."""
_RISE = 1.5
"""By what factor the advised rate rises at most at once."""


@dataclass(frozen=True, slots=True)
class Hint:
    """Advice; each None where what is sent is fine."""

    max_fps: int | None = None
    long_side_px: int | None = None


@dataclass(slots=True)
class Pace:
    """Compares what comes with what can be used."""

    most_fps: int
    """That the service allows."""
    hint: Hint = Hint()
    """The advice that holds."""
    _used: int = 0
    _came: int = 0
    _busy_s: float = 0.0
    _since_s: float | None = None
    _long_side: int = field(default=GOOD_PX)

    def used(self, at_s: float, used_s: float, dropped: int, long_side: int) -> Hint | None:
        """Count a used frame and those dropped before it; return the advice if it changes, at most once a window."""
        self._since_s = at_s if self._since_s is None else self._since_s
        self._used, self._came, self._busy_s = self._used + 1, self._came + 1 + dropped, self._busy_s + used_s
        self._long_side = long_side
        span_s = at_s - self._since_s
        if self._used < _WINDOW or span_s <= 0:
            return None
        offered, possible = self._came / span_s, self._used / max(self._busy_s, 1e-6)
        hint = Hint(self._rate(offered, possible), self._size())
        # Each window starts from nothing: an average over the whole session would answer to a change too late.
        self._used, self._came, self._busy_s, self._since_s = 0, 0, 0.0, at_s
        changed = hint != self.hint
        self.hint = hint
        return hint if changed else None

    def _rate(self, offered: float, possible: float) -> int | None:
        if offered > _SLACK * possible:
            return max(1, round(possible))
        # What was advised stays until clearly more could be used: the client sends less because of it.
        if self.hint.max_fps is not None and possible < _SLACK * self.hint.max_fps:
            return self.hint.max_fps
        if self.hint.max_fps is None:
            return None
        # In steps: how long frames take changes with what else the machine does.
        return min(self.most_fps, round(min(possible, _RISE * self.hint.max_fps)))

    def _size(self) -> int | None:
        return GOOD_PX if not MIN_USEFUL_PX <= self._long_side <= MAX_USEFUL_PX else None
