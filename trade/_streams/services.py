"""The services for streams that every container offers, in group ``trade``."""

from typing import Annotated

from msgspec import Meta

from trade._calls.handle import Handle
from trade._context.call_context import served_call
from trade._services.decorator import service
from trade._streams.source import LEAST_HZ, MOST_HZ, ListenerInfo, RateRequest, Streams

Hz = Annotated[float, Meta(ge=LEAST_HZ, le=MOST_HZ)]


class StreamServices:
    """Starts and ends streams of this container's services for clients in other containers, and lists them."""

    def __init__(self, streams: Streams) -> None:
        self._streams = streams

    @service(effect="read")
    def listen(self, name: str, service: Handle, hz: Hz, on_change: bool = False) -> None:
        """Sample a service of this container for the caller at a rate; the caller must renew this regularly.

        ``name`` is the listener's own; the samples are published on the key of the stream.
        """
        call = served_call()
        self._streams.listen(service, (call.session, name), RateRequest(call.caller, hz, on_change))

    @service(effect="read")
    def stream_listeners(self) -> list[ListenerInfo]:
        """The listeners of this container's services."""
        return self._streams.listeners()

    @service(effect="read")
    def unlisten(self, name: str) -> None:
        """End a stream of the caller, by its name."""
        self._streams.unlisten((served_call().session, name))
