"""Secret arguments reach the provider and show nowhere."""

from typing import Annotated, Any

import pytest
from msgspec import Meta

from trade import Handle, Secret, service
from trade._services.secret import MASK
from trade.errors import InvalidArgument

WORD = "correct horse battery"


class Vault:
    given: Any = None

    @service
    def unlock(self, name: str, password: Secret[str], pin: Secret[int | None] = 4711) -> str:
        self.given = (password, pin)
        return name

    @service
    def fail(self, password: Secret[str], codes: Secret[list[str]] = []) -> None:  # noqa: B006
        raise ValueError(f"{password!r} and {codes} are wrong", {"tried": password})

    @service
    def narrow(self, password: Secret[Annotated[str, Meta(max_length=3)]]) -> None: ...


def test_the_value_reaches_the_provider(offer: Any) -> None:
    vault = Vault()
    unlock = offer(vault)("unlock")
    assert unlock("bob", WORD) == "bob"
    assert vault.given == (WORD, 4711)
    assert unlock("bob", pin=5, password=WORD) == "bob"
    assert vault.given == (WORD, 5)


@pytest.mark.parametrize("by_name", [False, True])
def test_errors_do_not_show_it(offer: Any, by_name: bool) -> None:
    fail: Handle = offer(Vault())("fail")
    with pytest.raises(ValueError, match=r"\*\*\*") as caught:
        fail(password=WORD, codes=["alpha", "beta"]) if by_name else fail(WORD, ["alpha", "beta"])
    error = caught.value
    texts = str(error) + repr(error) + str(error.args) + str(error.__cause__)
    assert not any(secret in texts for secret in (WORD, "alpha", "beta"))
    assert error.args[1] == {"tried": MASK}


def test_what_does_not_fit_is_not_shown_either(offer: Any) -> None:
    with pytest.raises(InvalidArgument) as caught:
        offer(Vault())("narrow")(WORD)
    assert caught.value.argument == "password"
    assert WORD not in str(caught.value) + str(vars(caught.value)) + str(caught.value.__cause__)


def test_descriptions_say_that_it_is_secret_and_not_its_default(offer: Any) -> None:
    unlock: Handle = offer(Vault())("unlock")
    properties = unlock.schema["arguments"]["properties"]
    assert properties["password"] == {"type": "string", "writeOnly": True}
    assert "writeOnly" not in properties["name"]
    assert unlock.signature == "unlock(name: str, password: str, pin: int | None = ***) -> str"
    assert "4711" not in str(unlock.schema) + unlock.signature
