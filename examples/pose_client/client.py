"""Prints the poses of a running service: client.py [PORT | SOCKET]."""

import json
import socket
import sys

place = sys.argv[1] if len(sys.argv) > 1 else "7000"
connection = socket.socket(socket.AF_INET if place.isdigit() else socket.AF_UNIX)
connection.connect(("127.0.0.1", int(place)) if place.isdigit() else place)
for line in connection.makefile():
    pose = json.loads(line)
    print(pose["unix_ns"], pose["state"], *(f"{v:.3f}" for v in pose["map_position"]), f"{pose['latency_ms']:.1f} ms")
