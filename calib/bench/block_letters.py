"""Block letters, readable from across the room."""

from collections.abc import Sequence
from typing import Final

HEIGHT: Final = 5
"""Height of a letter, dots."""


_GLYPHS: Final = {
    glyph[0]: tuple(glyph[1:])
    for glyph in map(
        str.split,
        """
        A .#. #.# ### #.# #.#
        B ##. #.# ##. #.# ##.
        C .## #.. #.. #.. .##
        D ##. #.# #.# #.# ##.
        E ### #.. ##. #.. ###
        F ### #.. ##. #.. #..
        G .### #... #.## #..# .##.
        H #.# #.# ### #.# #.#
        I ### .#. .#. .#. ###
        J ..# ..# ..# #.# .#.
        K #.# #.# ##. #.# #.#
        L #.. #.. #.. #.. ###
        M #...# ##.## #.#.# #...# #...#
        N #..# ##.# #.## #..# #..#
        O ### #.# #.# #.# ###
        P ### #.# ### #.. #..
        Q ###. #.#. #.#. #### ...#
        R ##. #.# ##. #.# #.#
        S ### #.. ### ..# ###
        T ### .#. .#. .#. .#.
        U #.# #.# #.# #.# ###
        V #.# #.# #.# #.# .#.
        W #...# #...# #.#.# ##.## #...#
        X #.# #.# .#. #.# #.#
        Y #.# #.# .#. .#. .#.
        Z ### ..# .#. #.. ###
        0 ### #.# #.# #.# ###
        1 .#. ##. .#. .#. ###
        2 ### ..# ### #.. ###
        3 ### ..# .## ..# ###
        4 #.# #.# ### ..# ..#
        5 ### #.. ### ..# ###
        6 ### #.. ### #.# ###
        7 ### ..# ..# .#. .#.
        8 ### #.# ### #.# ###
        9 ### #.# ### ..# ###
        + ... .#. ### .#. ...
        - ... ... ### ... ...
        : . # . # .
        , .. .. .. .# #.
        . . . . . #
        ! # # # . #
        ? ### ..# .## ... .#.
        / ..# ..# .#. #.. #..
        """.strip().splitlines(),
    )
}


_SPACE: Final = ("..",) * HEIGHT


_UNKNOWN: Final = ("###",) * HEIGHT


def dots(text: str) -> list[str]:
    """Draw a line of text.

    Parameters
    ----------
    text : str
        Lower case is drawn as upper case.

    Returns
    -------
    list of str
        `HEIGHT` rows of ``#`` and ``.``, all of the same length.
    """
    glyphs = [_SPACE if letter == " " else _GLYPHS.get(letter, _UNKNOWN) for letter in text.upper()]
    return [".".join(glyph[row] for glyph in glyphs) for row in range(HEIGHT)]


def fitted(text: str, width: int, height: int) -> tuple[int, list[str]]:
    """Break text into lines and choose the largest scale that fits.

    Parameters
    ----------
    text : str
        Words to draw.
    width, height : int
        Cells of the terminal; a cell is one dot wide and two high.

    Returns
    -------
    int
        Scale, dots; 0 if not even the smallest fits.
    list of str
        The lines.
    """
    for scale in range(6, 0, -1):
        lines = _wrapped(text.split(), width // scale)
        if lines and rows(lines, scale) <= height:
            return scale, _balanced(lines)
    return 0, [text]


def rows(lines: Sequence[str], scale: int) -> int:
    """Return the height of lines with gaps between them, cells."""
    return len(lines) * cells(scale) + len(lines) - 1


def cells(scale: int) -> int:
    """Return the height of a line, cells."""
    return -(-HEIGHT * scale // 2)


def blocks(text: str, scale: int, ascii_only: bool = False) -> list[str]:
    """Draw a line of text with block characters.

    Parameters
    ----------
    text : str
        Text to draw.
    scale : int
        Width of a dot, cells; its height is half as many.
    ascii_only : bool
        The terminal has no block characters.

    Returns
    -------
    list of str
        Rows.
    """
    drawn = [row for row in dots(text) for _ in range(scale)]
    if len(drawn) % 2:
        drawn.append("." * len(drawn[0]))
    signs = " #'.#" if ascii_only else " █▀▄"
    out = []
    for upper, lower in zip(drawn[::2], drawn[1::2], strict=True):
        pairs = zip(upper, lower, strict=True)
        out.append("".join(signs[_SIGN[pair]] * scale for pair in pairs))
    return out


_SIGN: Final = {(".", "."): 0, ("#", "#"): 1, ("#", "."): 2, (".", "#"): 3}


def _balanced(lines: list[str]) -> list[str]:
    """Break the text into the same number of lines, the longest as short as possible."""
    words = " ".join(lines).split()
    for width in range(max(len(dots(line)[0]) for line in lines) - 1, 0, -1):
        shorter = _wrapped(words, width)
        if len(shorter) != len(lines):
            break
        lines = shorter
    return lines


def _wrapped(words: Sequence[str], width: int) -> list[str]:
    """Break words into lines of at most `width` dots; return none if a word is wider."""
    lines: list[str] = []
    for word in words:
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and len(dots(longer)[0]) <= width:
            lines[-1] = longer
        elif len(dots(word)[0]) <= width:
            lines.append(word)
        else:
            return []
    return lines
