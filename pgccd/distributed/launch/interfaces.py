"""The network interfaces of this machine and their addresses.

Python lists interfaces without addresses, and the machine's name resolves to 127.0.1.1 on Debian, or not at all.
"""

from __future__ import annotations

import array
import fcntl
import ipaddress
import socket
import struct
from pathlib import Path

_LIST = 0x8912  # SIOCGIFCONF
# Bytes of an entry: a name and an address.
_ENTRY, _NAME = 40, 16
_MOST_ADDRESSES = 256
_IPV6 = Path("/proc/net/if_inet6")


def addresses() -> dict[str, str]:
    """The interface of each IPv4 and IPv6 address of this machine, loopback included."""
    return _ipv4() | _ipv6()


def outer_addresses() -> list[str]:
    """The addresses at which other machines may reach this one."""
    found = [address for address in addresses() if not is_loopback(address)]
    return [address for address in found if not ipaddress.ip_address(address).is_link_local]


def interface_of(address: str) -> str | None:
    """The interface with this address; None if this machine has none."""
    return addresses().get(plain(address))


def plain(address: str) -> str:
    """An address of a socket, without the prefix of IPv4 addresses in IPv6 and without a scope."""
    return address.removeprefix("::ffff:").partition("%")[0]


def is_loopback(host: str) -> bool:
    """Whether a host is reachable from this machine only."""
    host = plain(host)
    return host in ("localhost", "::1") or host.startswith("127.")


def _ipv4() -> dict[str, str]:
    buffer = array.array("B", bytes(_ENTRY * _MOST_ADDRESSES))
    place, length = buffer.buffer_info()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, _LIST, struct.pack("iL", length, place))
    size, _ = struct.unpack("iL", answer)
    raw, found = buffer.tobytes()[:size], {}
    for begin in range(0, size, _ENTRY):
        name = raw[begin : begin + _NAME].split(b"\0")[0].decode().partition(":")[0]  # without the label of an alias
        found[socket.inet_ntoa(raw[begin + _NAME + 4 : begin + _NAME + 8])] = name
    return found


def _ipv6() -> dict[str, str]:
    try:
        lines = _IPV6.read_text().splitlines()
    except OSError:  # no IPv6
        return {}
    columns = [line.split() for line in lines]
    return {str(ipaddress.IPv6Address(bytes.fromhex(line[0]))): line[5] for line in columns}
