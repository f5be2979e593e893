"""Languages of what people read, and the catalogue of the monitor: its texts by key, in each language."""

import locale
import os
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from typing import Final

import yaml

LANGUAGES: Final = ("en", "zh_CN")
"""Languages with a catalogue; the first one is the default."""


_PAGE: Final = "page_"
_COMMAS: Final = frozenset(",，、")
_SEMICOLONS: Final = frozenset(";；")


def language(name: str | None = None) -> str:
    """Return the one of `LANGUAGES` that is nearest to a language.

    Parameters
    ----------
    name : str, optional
        Such as ``zh_CN``, ``zh-Hans`` or ``en_GB.UTF-8``. Default: the language of the system.

    Returns
    -------
    str
        ``en`` for an unknown language.
    """
    name = (name or _system_language()).replace("-", "_").lower()
    return next((known for known in LANGUAGES if name[:2] == known[:2]), LANGUAGES[0])


def _system_language() -> str:
    names = (os.environ.get(variable) for variable in ("LC_ALL", "LC_MESSAGES", "LANG"))
    name = next(filter(None, names), None) or locale.getlocale()[0] or ""
    return name.replace("Chinese", "zh")  # as Windows calls it


@cache
def catalogue(language: str, package: str = __name__) -> Mapping[str, str]:
    """Return the texts of one of `LANGUAGES` by key: those of the file of its name in a package."""
    content = resources.files(package).joinpath(f"{language}.yaml").read_bytes()
    texts: dict[str, str] = yaml.safe_load(content)
    return texts


def page_labels(package: str = __name__) -> dict[str, dict[str, str]]:
    """Return the labels of a page by language and by their names there, from the catalogues of a package."""
    return {
        name: {
            key.removeprefix(_PAGE): text
            for key, text in catalogue(name, package).items()
            if key.startswith(_PAGE)
        }
        for name in LANGUAGES
    }


def joined(items: Iterable[str], language: str) -> str:
    """Return the items of a list as one text in one of `LANGUAGES`, in which each item is seen as one.

    They are separated by commas; by semicolons if an item contains a comma; numbered if one contains a
    semicolon.
    """
    texts, items = catalogue(language), list(items)
    marks = frozenset().union(*items) & (_COMMAS | _SEMICOLONS)
    if len(items) > 1 and marks & _SEMICOLONS:
        items = [texts["numbered"].format(number=k, item=item) for k, item in enumerate(items, 1)]
    return texts["semicolon" if marks else "comma"].join(items)


def named(texts: Mapping[str, str], kind: str, name: str) -> str:
    """Return the text of one of the names of a kind, such as ``disk full``; any other text as it is."""
    return texts.get(f"{kind}_{name.replace(' ', '_')}", name)
