"""The drive and its bench in WebAssembly as a program with the command line of the host executable: the module runs in
Node, this process serves its local bus, in lock-step, to one client after the other.

    python -m salient.bench.wasm MODULE.wasm --can unix:PATH --pace lockstep --machine-image FILE ...
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

from salient.errors import UsageError
from salient.paths import TAB_PAGE

PROGRAM = TAB_PAGE / "target.mjs"
_SIZE = struct.Struct("<I")
_TIME_BYTES = 8
_RECORD_BYTES = {16: 24, 72: 80}
"""Bytes of a record by the bytes of its frame."""
_SEND_BUFFER_BYTES = 8 * 1024 * 1024
_SO_SNDBUFFORCE = 32  # missing in Python's socket module
_LENGTH_OFFSET = 12
_ONLY_HERE = ("can", "machine_image", "record", "record_switches", "follow_stdin")


def options_of(arguments: list[str]) -> dict[str, Any]:
    """The options of a command line by name; True for one without a value."""
    options: dict[str, Any] = {}
    for word in arguments:
        if word.startswith("--"):
            name = word[2:].replace("-", "_")
            options[name] = True
        else:
            options[name] = word
    return options


class Module:
    """The module in Node. Refuses options by UsageError."""

    def __init__(self, module: Path, options: dict[str, Any]) -> None:
        for name in ("memory", "stop_at_s"):
            if name in options:
                raise UsageError(f"--{name.replace('_', '-')}: not with the drive in WebAssembly")
        if options.get("drives", "1") != "1":
            raise UsageError("--drives: not with the drive in WebAssembly, which is one")
        if options.get("pace") != "lockstep":
            raise UsageError("--pace: must be lockstep with the drive in WebAssembly")
        setting = {
            "image": options["machine_image"], "record": options.get("record"),
            "record_switches": options.get("record_switches"),
            "options": {name: value for name, value in options.items() if name not in ("can", "machine_image",
                                                                                       "follow_stdin")},
        }
        self._process = subprocess.Popen(["node", str(PROGRAM), str(module)], stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE)
        assert self._process.stdin is not None and self._process.stdout is not None  # pipes
        self._requests: IO[bytes] = self._process.stdin
        self._answers: IO[bytes] = self._process.stdout
        self.records(json.dumps(setting).encode())

    def records(self, request: bytes) -> bytes:
        """The records that the bench sends after a request, a frame."""
        try:
            self._requests.write(_SIZE.pack(len(request)) + request)
            self._requests.flush()
        except BrokenPipeError:
            sys.exit(self._process.wait() or 1)
        head = self._answers.read(_SIZE.size)
        if len(head) < _SIZE.size:
            sys.exit(self._process.wait() or 1)
        return self._answers.read(_SIZE.unpack(head)[0])

    def close(self) -> int:
        """Ends the recordings; the exit code."""
        self._requests.close()
        return self._process.wait()


def serve(module: Module, path: str) -> None:
    """Serves the bus until standard input ends."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    os.fchmod(listener.fileno(), 0o600)  # of the file, too, as of transport_local.c
    listener.bind(path)
    Path(path).chmod(0o600)  # what the umask has taken away
    listener.listen()
    print(json.dumps({"ready": True, "can": f"unix:{path}", "pid": os.getpid()}), flush=True)
    client: socket.socket | None = None
    try:
        while True:
            waiting = [sys.stdin, listener if client is None else client]
            readable, _, _ = select.select(waiting, [], [])
            if sys.stdin in readable and not os.read(sys.stdin.fileno(), 4096):
                return
            if listener in readable:
                client, _ = listener.accept()
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            elif client in readable:
                assert client is not None
                request = client.recv(128)
                if not request:
                    client.close()
                    client = None
                elif not _send(client, module.records(request[_TIME_BYTES:])):
                    client = None
    finally:
        Path(path).unlink()


def _send(client: socket.socket, records: bytes) -> bool:
    """False when the client has left."""
    at = 0
    try:
        while at < len(records):
            is_flexible = records[at + _LENGTH_OFFSET + 1] & 4  # CANFD_FDF; padding of a classic frame
            size = _RECORD_BYTES[72 if is_flexible else 16]
            client.send(records[at : at + size])
            at += size
    except (BrokenPipeError, ConnectionResetError):
        return False
    return True


def main(arguments: list[str]) -> int:
    """Serves the module of the first argument; the exit code of the host executable."""
    module, *line = arguments
    options = options_of(line)
    try:
        running = Module(Path(module), options)
    except UsageError as error:
        print(f"salient: {error}", file=sys.stderr)
        return 2
    serve(running, str(options["can"]).removeprefix("unix:"))
    return running.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
