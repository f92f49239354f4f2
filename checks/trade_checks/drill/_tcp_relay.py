"""A TCP relay between two gateways, as a process that can be frozen: ``_relay PORT PORT`` forwards to these ports.

It prints the two ports on which it listens, and ends with standard input.
"""

import asyncio
import json
import sys

from trade_gateway.process._parent_watch import end_with_stdin

_CHUNK = 65536


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()
    except OSError:  # the other end is closed, so this one is too
        pass
    finally:
        writer.close()


async def _listen(port: int) -> asyncio.Server:
    """Listens on a port whose connections are forwarded to the given one."""

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", port)
        except OSError:  # the target does not listen now
            writer.close()
            return
        await asyncio.gather(_pass_on(reader, back), _pass_on(there, writer))

    return await asyncio.start_server(connected, "127.0.0.1", 0)


async def _relay(ports: list[int]) -> None:
    servers = [await _listen(port) for port in ports]
    print(json.dumps({"ports": [server.sockets[0].getsockname()[1] for server in servers]}), flush=True)  # noqa: T201
    await asyncio.gather(*(server.serve_forever() for server in servers))


if __name__ == "__main__":
    end_with_stdin()
    asyncio.run(_relay([int(word) for word in sys.argv[1:]]))
