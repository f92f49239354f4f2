"""Reading a robot file from disk."""

from os import PathLike
from pathlib import Path

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade_drivers.robotfile import Robot, parse


def load(path: str | PathLike[str]) -> Robot:
    """Reads and checks a robot file.

    Raises:
        ConfigurationError: the file cannot be read or is invalid; the message names file, key and remedy.
    """
    where = str(path)
    try:
        text = read_text(Path(path))
    except FileNotFoundError:
        raise ConfigurationError(where=where, problem="there is no such file") from None
    except IsADirectoryError:
        raise ConfigurationError(where=where, problem="is a directory; name the robot file in it") from None
    except UnicodeDecodeError as bad:
        raise ConfigurationError(where=where, problem=f"is not UTF-8 text (byte {bad.start}: {bad.reason})") from None
    except OSError as bad:
        raise ConfigurationError(where=where, problem=f"cannot be read: {bad.strerror}") from None
    return parse(text, where)
