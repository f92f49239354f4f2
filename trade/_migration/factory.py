"""Creates objects in a container on request, of classes that its settings allow."""

import importlib
import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

from trade._calls.handle import Handle
from trade._migration.delivered_code import CodeStore
from trade._protocol.keys import Address
from trade._services.providers import Providers
from trade._services.withdrawn import Withdrawn
from trade.errors import CannotInstantiate, ConfigurationError, NoSuchClass, NotInstantiable

_logger = logging.getLogger("trade")
_PATH: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


Arguments = Sequence[Any] | Mapping[str, Any]


class _Made(NamedTuple):
    provider: object
    args: Arguments


_hosts: Final[dict[int, object]] = {}
"""The open containers of the process that host objects of others, in this order."""


def first_host() -> object | None:
    """The first open container of the process that hosts objects of others; None if none does."""
    return next(iter(list(_hosts.values())), None)


class ProviderFactory:
    """Owns the objects created here: each is closed when a client terminates it, or with the container.

    Args:
        container: hosts the objects; their code uses it by default.
        own: its address.
        register: registers a created object in groups.
        providers: of the container.
        withdrawn: of the container.
        allowed: patterns of the classes that may be created.
        code: what was sent here for import.
    """

    def __init__(
        self,
        container: object,
        own: Address,
        register: Callable[[object, Sequence[str]], tuple[Handle, ...]],
        providers: Providers,
        withdrawn: Withdrawn,
        allowed: Sequence[str],
        code: CodeStore,
    ) -> None:
        self.code: Final = code
        self._container = container
        self._own = own
        self._register = register
        self._providers = providers
        self._withdrawn = withdrawn
        self._allowed = tuple(allowed)
        self._lock = threading.Lock()
        self._made: dict[int, _Made] = {}

    def host(self) -> None:
        """Lets code of others in this process, such as drivers of other packages, use this container by default."""
        _hosts.setdefault(id(self), self._container)

    def find(self, class_path: str) -> type:
        """The class of a path, in the module that defines it; only modules of allowed classes are imported.

        Raises:
            NotInstantiable: the settings do not allow it.
            NoSuchClass: the class does not exist.
            CannotInstantiate: its module cannot be imported.
        """
        where = self._own.container
        if not any(fnmatchcase(class_path, pattern) for pattern in self._allowed):
            raise NotInstantiable(class_path=class_path, container=where, allowed=self._allowed)
        if not _PATH.fullmatch(class_path):
            raise NoSuchClass(class_path=class_path, container=where, reason="a path looks like package.module:Class")
        module_name, _, qualified = class_path.partition(":")
        self.host()
        try:
            found: Any = importlib.import_module(module_name)
        except Exception as error:
            if isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}."):
                raise NoSuchClass(class_path=class_path, container=where, reason=str(error)) from None
            raise CannotInstantiate(class_path=class_path, container=where, problem=_error_text(error)) from error
        for part in qualified.split("."):
            found = getattr(found, "__dict__", {}).get(part)
        if not isinstance(found, type):
            raise NoSuchClass(class_path=class_path, container=where, reason=f"{module_name} has no such class")
        if path_of(found) != class_path:  # a pattern allows what its modules define, not what they import
            raise NoSuchClass(class_path=class_path, container=where, reason=f"it is defined as {path_of(found)}")
        return found

    def make(self, kind: type, args: Arguments) -> object:
        """Create an object of a class that `find` returned. Raises CannotInstantiate."""
        try:
            return kind(**args) if isinstance(args, Mapping) else kind(*args)
        except Exception as error:
            where = self._own.container
            raise CannotInstantiate(class_path=path_of(kind), container=where, problem=_error_text(error)) from error

    def offer(self, made: object, groups: Sequence[str], args: Arguments = ()) -> tuple[Handle, ...]:
        """Register a created object; close it if that fails."""
        try:
            handles = self._register(made, groups)
        except BaseException:
            end(made)
            raise
        self.keep(made, args)
        return handles

    def keep(self, made: object, args: Arguments) -> None:
        """Keep an object that was created here, with its arguments."""
        with self._lock:
            self._made[id(made)] = _Made(made, args)

    def arguments_of(self, provider: object) -> Arguments:
        """The arguments that a provider was created with; empty if it was not created here."""
        with self._lock:
            made = self._made.get(id(provider))
        return () if made is None else made.args

    def release(self, provider: object) -> None:
        """Close a provider that has moved away, so that it is not offered again, whatever created it."""
        self._withdrawn.forget(provider)
        with self._lock:
            self._made.pop(id(provider), None)
        end(provider)

    def terminate(self, service: Handle) -> None:
        """See `System.terminate`."""
        key, offered = service.key, None
        if key.address == self._own:
            offered = self._providers.offer(f"{key.domain}/{key.provider}") or self._withdrawn.offer(key.provider)
        made = None if offered is None else self._made.get(id(offered.provider))
        if made is None:
            problem = "it was not made by instantiate of this container; deregister withdraws others"
            raise ConfigurationError(where=service.label, problem=problem)
        if self._withdrawn.offer(key.provider) is None:
            self._withdrawn.take_off(key)
        self.release(made.provider)

    def close(self) -> None:
        """Close all objects created here. Idempotent."""
        with self._lock:
            made, self._made = list(self._made.values()), {}
        for one in reversed(made):
            end(one.provider)
        _hosts.pop(id(self), None)


def path_of(kind: type) -> str:
    """``module:qualified name``."""
    return f"{kind.__module__}:{kind.__qualname__}"


def end(made: object) -> None:
    """Close an object that has `close`; log any error."""
    close = getattr(made, "close", None)
    if callable(close):
        try:
            close()
        except Exception:
            _logger.exception("%s could not be closed", type(made).__qualname__)


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
