"""A mean rate of bytes, kept."""


class TokenBucket:
    """Keeps a mean rate: a message may go while tokens are left, and may leave a debt to be waited out."""

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._burst = min(per_s, max(65536.0, 0.05 * per_s))
        self._tokens = self._burst
        self._filled_s: float | None = None

    def delay_s(self, now_s: float) -> float:
        """How long until the next message may go; 0 now."""
        if self._filled_s is not None:
            self._tokens = min(self._burst, self._tokens + (now_s - self._filled_s) * self._per_s)
        self._filled_s = now_s
        return 0.0 if self._tokens > 0 else (1.0 - self._tokens) / self._per_s

    def spend(self, size: int) -> None:
        """A message of `size` bytes went."""
        self._tokens -= size
