"""Licences of the packages that this one depends on, with all its extras; exit code 1 if one is not allowed.

tools/run python tools/licences.py
"""

import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PACKAGE: Final = "imu50"

ALLOWED: Final = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "CC0-1.0",
        "ISC",
        "LGPL-3.0-only",
        "LGPL-3.0-or-later",
        "MIT",
        "MIT-0",
        "MIT-CMU",
        "MPL-2.0",
        "PSF-2.0",
        "Unlicense",
        "Zlib",
    }
)
"""SPDX identifiers. Packages under MPL and LGPL are used as they are, as separate files."""

ALIASES: Final = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception": "Apache-2.0",
    "BSD": "BSD-3-Clause",
    "BSD License": "BSD-3-Clause",
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0-only",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
}
"""Other names of allowed licences: those of the package index, and of packages without an identifier."""

STATED: Final = {
    "allantools": "LGPL-3.0-or-later",
    "docutils": "BSD-2-Clause",  # the GPL is that of its mode for Emacs; of allantools, for tests alone
    "eclipse-zenoh": "EPL-2.0 OR Apache-2.0",
}
"""Licences of packages whose metadata have a text, or a list that leaves open what applies to what."""

_CLASSIFIER: Final = "License :: OSI Approved :: "


def is_allowed(licence: str) -> bool:
    """Return whether a licence is allowed.

    Parameters
    ----------
    licence : str
        SPDX expression without parentheses, or another name; of names joined by OR one must be allowed, of
        those joined by AND all.
    """
    return ALIASES.get(licence, licence) in ALLOWED or any(
        all(ALIASES.get(name, name) in ALLOWED for name in re.split(" AND ", part))
        for part in re.split(" OR ", licence)
    )


def licence_of(package: Distribution) -> str:
    """Return the licence that a package states; empty if it states none."""
    stated = package.metadata.get_all("License-Expression") or [
        text.removeprefix(_CLASSIFIER)
        for text in package.metadata.get_all("Classifier", [])
        if text.startswith(_CLASSIFIER)
    ]
    return " AND ".join(stated) or package.metadata.get("License", "")


def dependencies(name: str, extras: frozenset[str], seen: set[tuple[str, str]]) -> Iterator[str]:
    """Yield the names of the packages that a package needs, with their own dependencies.

    Parameters
    ----------
    name : str
        Name of an installed package; of another one the dependencies are unknown, and none is yielded.
    extras : frozenset of str
        Extras that are wanted.
    seen : set of (str, str)
        Names and extras that were yielded before; more are added.
    """
    try:
        requirements = [Requirement(text) for text in distribution(name).requires or []]
    except PackageNotFoundError:
        return
    for needed in requirements:
        for extra in sorted({"", *extras}):
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                other = canonicalize_name(needed.name)
                new = {(other, wanted) for wanted in ("", *needed.extras)} - seen
                seen |= new
                if (other, "") in new:
                    yield other
                if new:
                    yield from dependencies(other, frozenset(needed.extras), seen)


def main() -> int:
    """Print the licences; return the exit code."""
    extras = frozenset(distribution(PACKAGE).metadata.get_all("Provides-Extra", []))
    refused = 0
    for name in sorted(set(dependencies(PACKAGE, extras, set())) - {PACKAGE}):
        try:
            package = distribution(name)
        except PackageNotFoundError:
            print(f"      {name}: not installed")
            continue
        licence = STATED.get(name) or licence_of(package)
        is_good = is_allowed(licence)
        refused += not is_good
        print(
            f"{'ok' if is_good else 'FAIL':4}  {name} {package.version}: {licence or 'no licence is stated'}"
        )
    return min(refused, 1)


if __name__ == "__main__":
    sys.exit(main())
