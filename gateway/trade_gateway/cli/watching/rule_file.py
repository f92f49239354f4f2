"""The services of a container that runs rules, in group ``trade``: show, try and change its rules file."""

from pathlib import Path

from msgspec import Struct

from trade import Container, current_call, service
from trade.errors import ConfigurationError
from trade.rules import DryRun, read_rules, rehearse
from trade_gateway.config.document import Document, FileText


class RuleTrial(Struct, frozen=True, kw_only=True):
    """What a changed rules file would do."""

    problem: str
    """Why it is refused; empty if it is valid."""
    diff: list[str]
    rehearsals: list[DryRun]
    """What each rule would do in the current state of the system."""


class RuleFile:
    """Offers a rules file to those who may administer the system, as its rules run with the container's rights."""

    def __init__(self, container: Container, file: Path) -> None:
        self._container = container
        self._document = Document(file)

    @service(effect="read")
    def rule_file(self) -> FileText:
        """The rules file of this container."""
        return self._document.read()

    @service
    def try_rules(self, text: str) -> RuleTrial:
        """Check a rules file, and show what each rule would call now. Calls only the services of conditions."""
        diff = self._document.diff(text)
        try:
            rules = read_rules(self._document.path, text)
        except ConfigurationError as wrong:
            return RuleTrial(problem=str(wrong), diff=diff, rehearsals=[])
        return RuleTrial(problem="", diff=diff, rehearsals=rehearse(self._container, rules))

    @service
    def save_rules(self, text: str, version: str) -> None:
        """Replace the rules file, which is then read again; a wrong one, or one of an older version, is refused."""
        path = self._document.path
        self._document.write(text, version, lambda: read_rules(path, text))
        call = current_call()
        self._container.note_change("rules written", f"{path}, by {'itself' if call is None else call.caller}")
