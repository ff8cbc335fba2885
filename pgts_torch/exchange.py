"""What processes that train together send each other: bytes, over sockets, combined in the order of ranks.

Rank 0 receives a message of each other rank, and sends all of them the same answer. A small exchange takes a small
part of the time of gloo's, which hands each message from thread to thread: so a gradient can be summed in every step.
"""

import pickle
import secrets
import socket
import struct
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, final

import torch
from torch import distributed

from pgts_torch.errors import PgtsError, RankLost

_MOST_LETTERS = 48
_HEADER = struct.Struct(f"<{_MOST_LETTERS}sBQ")
"""The name of the exchange, the status of the message, and how many bytes follow."""

_FINE, _FAILED, _OUT_OF_STEP = range(3)

_SMALL = 1 << 16
"""Up to so many bytes are copied, to be sent by one call of the operating system."""


@final
class Exchange:
    """The sockets of one process to the others. All processes must make the same calls in the same order.

    num_calls, num_bytes: how many exchanges there were, and what this process has put into them.

    Args:
        rank: the number of this process.
        links: in rank 0 the sockets to ranks 1, 2, ...; in another one that to rank 0.
    """

    def __init__(self, rank: int, links: Sequence[socket.socket]) -> None:
        self._rank, self._links = rank, links
        self.num_calls = self.num_bytes = 0

    @classmethod
    def of_group(cls, group: Any) -> "Exchange":
        """Connect the processes of the default group of torch.distributed, which must all call this.

        Processes of one machine meet where no other machine can reach them. Those that connect show a secret.
        """
        rank, size = distributed.get_rank(), distributed.get_world_size()
        hosts = _told(socket.gethostname())
        host = "127.0.0.1" if len(set(hosts)) == 1 else socket.gethostbyname(hosts[0])
        with socket.socket() as listening:
            if rank == 0:
                listening.bind((host, 0))
                listening.listen(size)
            port, secret = _told((listening.getsockname()[1], secrets.token_bytes(16)))[0]
            timeout: timedelta = group._get_backend(torch.device("cpu")).options._timeout
            if rank:
                link = _patient(socket.create_connection((host, port), timeout.total_seconds()), timeout)
                link.sendall(secret + rank.to_bytes(4, "little"))
                return cls(rank, [link])
            links: dict[int, socket.socket] = {}
            while len(links) < size - 1:
                link = _patient(listening.accept()[0], timeout)
                greeting = bytes(_received(link, 20))
                if secrets.compare_digest(greeting[:16], secret):
                    links[int.from_bytes(greeting[16:], "little")] = link
            return cls(rank, [links[other] for other in range(1, size)])

    def swap(self, what: str, sent: Any, combine: Callable[[list[Any]], Any]) -> Any:
        """Return what `combine` makes, in rank 0, of what all ranks have sent, in their order.

        Args:
            what: the name of this exchange, of at most 48 bytes.
            sent: bytes, or an error of this process in their place.
            combine: takes and returns bytes.

        Raises:
            PgtsError: that of the first rank which has sent one; or the ranks are at different exchanges.
            RankLost: a process is gone.
        """
        assert len(what.encode()) <= _MOST_LETTERS
        is_error = isinstance(sent, PgtsError)
        payload = memoryview(pickle.dumps(sent) if is_error else sent).cast("B")
        self.num_calls, self.num_bytes = self.num_calls + 1, self.num_bytes + len(payload)
        message = what, _FAILED if is_error else _FINE, payload
        try:
            status, answer = self._answered(message, combine) if self._rank == 0 else self._asked(message)
        except OSError as error:
            self.close()
            size = len(self._links) + 1 if self._rank == 0 else distributed.get_world_size()
            raise RankLost(f"rank {self._rank} of {size} has lost another one, asking for {what}") from error
        if status == _OUT_OF_STEP:
            names = pickle.loads(answer)
            rank, other = next((rank, name) for rank, name in enumerate(names) if name != what)
            raise PgtsError(f"rank {self._rank} asks for {what}, rank {rank} for {other}: they are out of step")
        if status == _FAILED:
            rank, received = pickle.loads(answer)
            # Its own error has the traceback, which the pickled one lacks.
            failure = sent if rank == self._rank else received
            failure.rank = rank
            raise failure
        return answer

    def close(self) -> None:
        """Close the sockets, so that others which wait for this process hear of it."""
        for link in self._links:
            link.close()

    def _asked(self, message: tuple[str, int, memoryview]) -> tuple[int, Any]:
        """Status and bytes of the answer of rank 0."""
        _send(self._links[0], *message)
        return _receive(self._links[0])[1:]

    def _answered(self, own: tuple[str, int, memoryview], combine: Callable[[list[Any]], Any]) -> tuple[int, Any]:
        """Answer the other ranks; return status and bytes of the answer."""
        messages = [own, *map(_receive, self._links)]
        failed = [rank for rank, (_, status, _) in enumerate(messages) if status == _FAILED]
        names = [name for name, _, _ in messages]
        if failed:
            status, answer = _FAILED, pickle.dumps((failed[0], pickle.loads(messages[failed[0]][2])))
        elif len(set(names)) > 1:
            status, answer = _OUT_OF_STEP, pickle.dumps(names)
        else:
            status, answer = _FINE, combine([payload for _, _, payload in messages])
        for link in self._links:
            _send(link, own[0], status, memoryview(answer).cast("B"))
        return status, answer


def _told(thing: Any) -> list[Any]:
    """What each process of the group says."""
    things: list[Any] = [None] * distributed.get_world_size()
    distributed.all_gather_object(things, thing)
    return things


def _patient(link: socket.socket, timeout: timedelta) -> socket.socket:
    """The socket, without delays; waiting for longer than the timeout is an OSError."""
    link.settimeout(None)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # By the operating system, because Python's own timeouts take another call for each.
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", int(timeout.total_seconds()), 0))
    return link


def _send(link: socket.socket, what: str, status: int, payload: memoryview) -> None:
    header = _HEADER.pack(what.encode(), status, len(payload))
    if len(payload) > _SMALL:
        link.sendall(header)
        link.sendall(payload)
    else:
        link.sendall(header + payload)


def _receive(link: socket.socket) -> tuple[str, int, memoryview]:
    name, status, size = _HEADER.unpack(_received(link, _HEADER.size))
    return name.rstrip(b"\0").decode(), status, _received(link, size)


def _received(link: socket.socket, size: int) -> memoryview:
    """The next bytes; an OSError where the other process has left."""
    buffer = memoryview(bytearray(size))
    missing = buffer
    while len(missing):
        count = link.recv_into(missing)
        if count == 0:
            raise ConnectionError("the other process has left")
        missing = missing[count:]
    return buffer
