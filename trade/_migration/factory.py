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
from trade._services.providers import Providers
from trade._services.withdrawn import WithdrawnProviders
from trade.errors import CannotInstantiate, ConfigurationError, NoSuchClass, NotInstantiable
from trade.protocol.keys import Address

_logger = logging.getLogger("trade")
_PATH: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


Arguments = Sequence[Any] | Mapping[str, Any]


class _CreatedProvider(NamedTuple):
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
        withdrawn_providers: WithdrawnProviders,
        allowed: Sequence[str],
        code: CodeStore,
    ) -> None:
        self.code: Final = code
        self._container = container
        self._own = own
        self._register = register
        self._providers = providers
        self._withdrawn_providers = withdrawn_providers
        self._allowed = tuple(allowed)
        self._lock = threading.Lock()
        self._created: dict[int, _CreatedProvider] = {}

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

    def make(self, provider_class: type, args: Arguments) -> object:
        """Create an object of a class that `find` returned. Raises CannotInstantiate."""
        try:
            return provider_class(**args) if isinstance(args, Mapping) else provider_class(*args)
        except Exception as error:
            where = self._own.container
            raise CannotInstantiate(
                class_path=path_of(provider_class), container=where, problem=_error_text(error)
            ) from error

    def offer(self, provider: object, groups: Sequence[str], args: Arguments = ()) -> tuple[Handle, ...]:
        """Register a created object; close it if that fails."""
        try:
            handles = self._register(provider, groups)
        except BaseException:
            end(provider)
            raise
        self.keep(provider, args)
        return handles

    def keep(self, provider: object, args: Arguments) -> None:
        """Keep an object that was created here, with its arguments."""
        with self._lock:
            self._created[id(provider)] = _CreatedProvider(provider, args)

    def arguments_of(self, provider: object) -> Arguments:
        """The arguments that a provider was created with; empty if it was not created here."""
        with self._lock:
            created = self._created.get(id(provider))
        return () if created is None else created.args

    def release(self, provider: object) -> None:
        """Close a provider that has moved away, so that it is not offered again, whatever created it."""
        self._withdrawn_providers.forget(provider)
        with self._lock:
            self._created.pop(id(provider), None)
        end(provider)

    def terminate(self, service: Handle) -> None:
        """See `System.terminate`."""
        key, offered = service.key, None
        if key.address == self._own:
            offered = self._providers.offer(f"{key.domain}/{key.provider}") or self._withdrawn_providers.offer(
                key.provider
            )
        created = None if offered is None else self._created.get(id(offered.provider))
        if created is None:
            problem = "it was not made by instantiate of this container; deregister withdraws others"
            raise ConfigurationError(where=service.label, problem=problem)
        if self._withdrawn_providers.offer(key.provider) is None:
            self._withdrawn_providers.take_off(key)
        self.release(created.provider)

    def close(self) -> None:
        """Close all objects created here. Idempotent."""
        with self._lock:
            created, self._created = list(self._created.values()), {}
        for one in reversed(created):
            end(one.provider)
        _hosts.pop(id(self), None)


def path_of(provider_class: type) -> str:
    """``module:qualified name``."""
    return f"{provider_class.__module__}:{provider_class.__qualname__}"


def end(provider: object) -> None:
    """Close an object that has `close`; log any error."""
    close = getattr(provider, "close", None)
    if callable(close):
        try:
            close()
        except Exception:
            _logger.exception("%s could not be closed", type(provider).__qualname__)


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
