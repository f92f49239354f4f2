"""Policies for tests, in short."""

import json

EVERYTHING = "call=* read=* register=* lock=* administer=* instrument=*"


def policy_text(identities: str, head: str = "", **roles: str) -> str:
    """A policy file.

    Args:
        identities: the roles of each, such as ``anna=operator bert=viewer,driver``.
        head: what the file begins with.
        roles: the rules of each, such as ``read=* call=rosie,lab``.
    """
    tables = [f"[roles.{role}]\n{_lists(rules)}" for role, rules in roles.items()]
    return "\n".join([head, *tables, f"[identities]\n{_lists(identities)}"])


def _lists(words: str) -> str:
    named = (word.partition("=") for word in words.split())
    return "".join(f"{_key(name)} = {json.dumps([one for one in each.split(',') if one])}\n" for name, _, each in named)


def _key(name: str) -> str:
    return name if name.replace("-", "_").isidentifier() else json.dumps(name)
