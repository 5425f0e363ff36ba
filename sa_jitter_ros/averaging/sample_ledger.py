"""Which samples were lost and which dropped, each counted once whatever the order they come in."""

from dataclasses import dataclass, field

Span = tuple[int, int]  # first index, and the one behind the last

_KEPT = 200  # spans that are remembered


@dataclass
class SampleLedger:
    """
    Account of the samples of one run that are not used, by their index.

    A sample that the index leaves out is lost, unless it came before and was dropped. One that
    comes after it was counted as lost is not dropped, too. The latest spans only are remembered.
    """

    _lost: list[Span] = field(default_factory=list)
    _dropped: list[Span] = field(default_factory=list)

    def lose(self, span: Span) -> int:
        """Take that the index leaves out a span; return how many samples are lost."""
        left = [span]
        for dropped in self._dropped:
            left = _without(left, dropped)
        self._lost = (self._lost + left)[-_KEPT:]
        return _size(left)

    def drop(self, span: Span) -> int:
        """Take that samples came and are not used; return how many of them were not lost."""
        before, self._lost = _size(self._lost), _without(self._lost, span)
        self._dropped = [*self._dropped, span][-_KEPT:]
        return span[1] - span[0] - (before - _size(self._lost))


def _without(spans: list[Span], gone: Span) -> list[Span]:
    """Return what is left of spans."""
    pieces = (piece for first, end in spans
              for piece in ((first, min(end, gone[0])), (max(first, gone[1]), end)))
    return [(first, end) for first, end in pieces if first < end]


def _size(spans: list[Span]) -> int:
    return sum(end - first for first, end in spans)
