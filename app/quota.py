"""How many requests a minute each API key may make: one token bucket per key."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable


class Quota:
    """Token buckets of ``per_minute`` requests that refill steadily.

    Only the given ``holders`` have buckets, so clients cannot make it grow.
    """

    def __init__(
        self,
        holders: Iterable[bytes],
        per_minute: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._capacity = float(per_minute)
        self._rate = per_minute / 60.0
        self._clock = clock
        now = clock()
        self._buckets = dict.fromkeys(holders, (self._capacity, now))

    def take(self, holder: bytes) -> int | None:
        """Count one request of ``holder``; None, or the whole seconds until one is allowed."""
        tokens, since = self._buckets[holder]
        now = self._clock()
        tokens = min(self._capacity, tokens + (now - since) * self._rate)
        if tokens < 1.0:
            self._buckets[holder] = tokens, now
            return max(1, math.ceil((1.0 - tokens) / self._rate))
        self._buckets[holder] = tokens - 1.0, now
        return None
