"""The licences of what is installed, as the packages themselves say. Run as a program it prints them.

Only the standard library: it is run by the Python whose packages it lists.
"""

import re
from collections.abc import Iterable
from importlib.metadata import Distribution, distributions
from typing import Final

PERMISSIVE: Final = re.compile(r"MIT|BSD|Apache|ISC|PSF|Python Software Foundation|Zlib|Unlicense|CC0", re.IGNORECASE)
AS_THEY_ARE: Final = {
    "apsw": "any licence that OSI approves: used under MIT",
    "certifi": "MPL-2.0: its files are used unchanged",
    "eclipse-zenoh": "EPL-2.0 or Apache-2.0: used under the latter",
    "python-can": "LGPL-3.0: used unchanged, as a library",
}
"""Packages with other licences, and why they may be used."""
_STRICTER: Final = re.compile(r"GPL|MPL|EPL|CDDL|Proprietary", re.IGNORECASE)


def licence(package: Distribution) -> str:
    """What a package says of itself: an SPDX expression, its classifiers, or the first line of what else it says."""
    said = package.metadata
    if expression := said.get("License-Expression"):
        return expression
    classified = [
        line.rpartition(" :: ")[2] for line in said.get_all("Classifier", []) if line.startswith("License ::")
    ]
    named = [one for one in classified if one != "OSI Approved"]
    return ", ".join(named) or (said.get("License") or "says none").strip().splitlines()[0]


def not_permissive(said: Iterable[tuple[str, str]]) -> list[str]:
    """The names and licences that a person has to check."""
    wrong = ((name, text) for name, text in said if _STRICTER.search(text) or not PERMISSIVE.search(text))
    return [f"{name}: {text}" for name, text in wrong if name not in AS_THEY_ARE]


def main() -> None:
    """A line for each package: name, version, licence."""
    for one in sorted(distributions(), key=lambda one: one.metadata["Name"].lower()):
        print(one.metadata["Name"].lower().replace("_", "-"), one.version, licence(one), sep="\t")


if __name__ == "__main__":
    main()
