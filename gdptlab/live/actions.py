"""What a trigger may call: a command to a serial port, a request to an address. Each answers in its time, or raises."""

from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from gdptlab._checks import instance, positive


def over_serial(port: str, command: bytes, answer: bytes, *, timeout_s: float = 0.2, **settings: Any) -> Callable:
    """Return an action that sends a command to a serial port and waits for the device's answer (extra `camera`).

    Parameters
    ----------
    port : str
        Such as "COM3", "/dev/ttyUSB0", or an address of pyserial. It is opened now, and kept.
    command, answer : bytes
        Such as b"OUTPUT OFF\\n" and b"OK\\n".
    timeout_s : float
        Longest time for either.
    **settings
        Of `serial.serial_for_url`, such as `baudrate`.

    Returns
    -------
    callable
        With any arguments, which have no effect, so that it can be the `action` of a `Trigger` and the `safe` of a
        `Monitor`. It raises a TimeoutError if the device does not answer in time, an OSError if with something else.
    """
    import serial

    for name, value in {"command": command, "answer": answer}.items():
        instance(name, value, bytes)
    seconds = positive("timeout_s", timeout_s)
    line = serial.serial_for_url(port, timeout=seconds, write_timeout=seconds, **settings)

    def act(*_: object) -> None:
        """Send the command."""
        line.reset_input_buffer()
        line.write(command)
        heard = line.read(len(answer))
        if heard != answer:
            kind = OSError if len(heard) == len(answer) else TimeoutError
            raise kind(f"{port} answered {heard!r} to {command!r}, expected was {answer!r} within {seconds:g} s")

    return act


def over_http(url: str, *, data: bytes | None = None, timeout_s: float = 0.2) -> Callable:
    """Return an action that asks for an address.

    Parameters
    ----------
    url : str
        http or https.
    data : bytes, optional
        What is posted; without it the address is only asked for.
    timeout_s : float
        Longest time to connect, and to wait for the answer.

    Returns
    -------
    callable
        As of `over_serial`. It raises an OSError if the device does not answer in time, or not with success.
    """
    if urlsplit(instance("url", url, str)).scheme not in ("http", "https"):
        raise ValueError(f"url: got {url!r}, allowed is one that begins with http:// or https://")
    seconds = positive("timeout_s", timeout_s)
    if data is not None:
        instance("data", data, bytes)

    def act(*_: object) -> None:
        """Ask for the address; any answer but one of success raises."""
        with urlopen(Request(url, data), timeout=seconds):
            pass

    return act
