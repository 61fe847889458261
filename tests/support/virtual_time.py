"""Time for tests of sources: nothing waits, and nothing depends on how busy the machine is."""


class VirtualTime:
    """A clock that only sleeping moves."""

    def __init__(self, now_ns: int = 0) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        """Let that much time pass, at once."""
        self.now_ns += round(seconds * 1e9)
