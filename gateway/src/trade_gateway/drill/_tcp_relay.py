"""A cable between two gateways, as a process that can be frozen: ``_relay PORT PORT`` passes on to those of this host.

It says where it listens for the one and for the other, and ends with standard input.
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
    except OSError:  # the other end is gone, so is this one
        pass
    finally:
        writer.close()


async def _listen(port: int) -> asyncio.Server:
    """Who connects here is connected to that port."""

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", port)
        except OSError:  # nobody listens there at present
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
