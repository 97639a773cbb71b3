"""Publishing with the numbers a device gives its samples, so that what it dropped is counted."""

from bridge.wire.session import WirePublisher

MAX_GAP = 10_000_000
"""A larger step is a counter that was set anew, not a loss."""


class NumberedPublisher:
    """Sends samples of one stream; numbers left out by the device become gaps on the wire.

    The recorder enters gaps of sequence numbers in its ledger of losses, wherever they arose.
    """

    def __init__(self, publisher: WirePublisher) -> None:
        """Take over a publisher that nobody else uses."""
        self._publisher = publisher
        self._expected: int | None = None
        self.sent = 0
        self.lost = 0

    def put(self, number: int, data: bytes, *, source_ns: int) -> int:
        """Send one sample and return how many are missing directly before it.

        Args:
            number: The device's count of this stream; starting again is no loss.
            data: The serialised message.
            source_ns: When the sample was taken [ns].
        """
        gap = 0 if self._expected is None else number - self._expected
        if not 0 < gap <= MAX_GAP:
            gap = 0
        self._expected = number + 1
        if gap:
            self._publisher.skip(gap)
            self.lost += gap
        self._publisher.put(data, source_ns=source_ns)
        self.sent += 1
        return gap
