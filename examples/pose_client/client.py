"""Prints the poses of a running service: client.py [PORT | SOCKET] [TOKEN_FILE]."""

import json
import os
import socket
import sys
from pathlib import Path

place = sys.argv[1] if len(sys.argv) > 1 else "7000"
token = Path(sys.argv[2]) if len(sys.argv) > 2 else Path.home() / ".local/state/stereo-sfm/token"
connection = socket.socket(socket.AF_INET if place.isdigit() else socket.AF_UNIX)
try:
    connection.connect(("127.0.0.1", int(place)) if place.isdigit() else place)
    if token.exists():
        connection.sendall(token.read_bytes())
except (OSError, OverflowError) as error:
    sys.exit(f"no service at {place}: {getattr(error, 'strerror', error)}")
try:
    for line in connection.makefile():
        pose = json.loads(line)
        where = (f"{v:.3f}" for v in pose["map_position"])
        print(pose["unix_ns"], pose["state"], *where, f"{pose['latency_ms']:.1f} ms", flush=True)
except BrokenPipeError:  # of standard output, as of `client.py | head`
    os._exit(0)
except OSError as error:
    sys.exit(f"the service at {place} has closed the connection: {error.strerror}")
except KeyboardInterrupt:
    sys.exit(130)
sys.exit(f"the service at {place} has closed the connection: it has ended, or the token in {token} is not its own")
