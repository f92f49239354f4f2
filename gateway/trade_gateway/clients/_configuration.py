"""The policy of the HTTP gateway and the rules of the system, which administrators show, try and change."""

from typing import Any, Final

import msgspec

from trade import Container, where
from trade.errors import ConfigurationError
from trade_gateway.clients._administration import Administration
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._changes import Done, FileBody, FileView, TextBody, Trial
from trade_gateway.clients._errors import NoPolicyFile
from trade_gateway.clients._policy_edit import changes, checked
from trade_gateway.clients._system_info import Counted
from trade_gateway.config.document import Document

_OWN: Final = "trade"


class Configuration:
    """Shows and changes configuration files in the names of clients.

    Args:
        container: the gateway's container.
        judge: authorises its clients.
        counted: runs a function with its arguments for an identity.
        administration: finds services of containers, and audits changes.
    """

    def __init__(
        self, container: Container, judge: ClientAuthorizer, counted: Counted, administration: Administration
    ) -> None:
        self._container = container
        self._judge = judge
        self._counted = counted
        self._noted = administration.noted
        self._own = administration.own
        self._policy: Document | None = None

    # --- the policy

    async def policy_file(self, identity: str) -> FileView:
        """Returns the file of the gateway's policy. Raises AccessDenied, NoPolicyFile."""
        self._judge.require_system(identity, "administer", "policy")
        return await self._counted(identity, lambda: _view(self._document().read()))

    async def try_policy(self, identity: str, body: TextBody) -> Trial:
        """Returns what a changed policy would do. Raises AccessDenied, NoPolicyFile."""
        self._judge.require_system(identity, "administer", "policy")

        def attempt() -> Trial:
            document = self._document()
            diff = document.diff(body.text)
            try:
                after = checked(document.path, body.text, self._editors(identity))
            except ConfigurationError as wrong:
                return Trial(str(wrong), diff, [])
            before = self._judge.policy
            return Trial("", diff, [] if before is None else changes(before, after))

        return await self._counted(identity, attempt)

    async def save_policy(self, identity: str, body: FileBody) -> Done:
        """Replaces the file of the gateway's policy, and applies it.

        Raises:
            AccessDenied, NoPolicyFile.
            ConfigurationError: it is wrong, would lock out the client or the gateway, or was changed meanwhile.
        """
        self._judge.require_system(identity, "administer", "policy")

        def save() -> Done:
            document = self._document()
            document.write(body.text, body.version, lambda: checked(document.path, body.text, self._editors(identity)))
            self._container.load_policy(document.path)
            return Done(f"{document.path} is written. Containers that use this file apply it within two seconds.")

        return await self._noted(identity, "policy written", "", save)

    def _document(self) -> Document:
        path = self._judge.policy_path
        if path is None:
            raise NoPolicyFile
        if self._policy is None or self._policy.path != path:
            self._policy = Document(path)
        return self._policy

    def _editors(self, identity: str) -> tuple[str, str]:
        """The client and the gateway: a change here needs the rights of both."""
        return identity, self._container.address.identity

    # --- rules

    async def rule_files(self, identity: str) -> list[FileView]:
        """Returns the rules files of all containers that run rules. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "rules")

        def read() -> list[FileView]:
            outcomes = self._container.call_all(where(name="rule_file", group=_OWN))
            return [_view(one.result, one.handle.container) for one in outcomes if one.ok]

        return await self._counted(identity, read)

    async def try_rules(self, identity: str, name: str, body: TextBody) -> Trial:
        """Returns what changed rules would do now. Raises AccessDenied, NoSuchService: no such container runs rules."""
        self._judge.require_system(identity, "administer", f"rules in {name}")

        def attempt() -> Trial:
            tried: Any = msgspec.to_builtins(self._own("try_rules", name)(body.text), enc_hook=str)
            return Trial(tried["problem"], tried["diff"], [_said(one) for one in tried["rehearsals"]])

        return await self._counted(identity, attempt)

    async def save_rules(self, identity: str, name: str, body: FileBody) -> Done:
        """Replaces a rules file. Raises AccessDenied, NoSuchService, ConfigurationError: as for policies."""
        self._judge.require_system(identity, "administer", f"rules in {name}")

        def save() -> Done:
            self._own("save_rules", name)(body.text, body.version)
            return Done(f"The rules in {name} are written. It applies them within a second.")

        return await self._noted(identity, "rules written", name, save)


def _view(file: Any, container: str = "") -> FileView:
    return FileView(container, file.path, file.text, file.version)


def _said(rehearsal: dict[str, Any]) -> str:
    """What a rule would do, in a sentence."""
    occasion = " ".join(filter(None, (rehearsal["occasion"], rehearsal["condition"])))
    now = f" ({rehearsal['now']})" if rehearsal["now"] else ""
    steps = "; ".join(f"{one['step']}: {one['error'] or one['result']}" for one in rehearsal["steps"])
    would = "would fire now" if rehearsal["fires"] else "would not fire now"
    return f"Rule {rehearsal['rule']}, {occasion}: {would}{now}. {steps}".strip()
