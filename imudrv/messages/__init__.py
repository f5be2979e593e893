"""Languages of what people read, and the catalogue of the monitor: its texts by key, in each language."""

import locale
import os
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Final

import yaml

LANGUAGES: Final = ("en", "zh_CN")
"""Languages with a catalogue; the first one is the default."""


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


def named(texts: Mapping[str, str], kind: str, name: str) -> str:
    """Return the text of one of the names of a kind, such as ``disk full``; any other text as it is."""
    return texts.get(f"{kind}_{name.replace(' ', '_')}", name)
