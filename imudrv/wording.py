"""Words that depend on a count.

>>> counted(1, "rest"), counted(3, "rest")
('1 rest', '3 rests')
>>> "{n} {n:rest is|rests are} lost".format(n=Count(1))
'1 rest is lost'
"""


class Count(int):
    """A count in a text of a catalogue, which may choose between the words for one and for others."""

    def __format__(self, spec: str) -> str:
        one, bar, others = spec.partition("|")
        if not bar:
            return super().__format__(spec)
        return one if self == 1 else others


def counted(n: int, noun: str) -> str:
    """Return a count with its noun."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
