#!/bin/sh
# Prints the poses of a running service: client.sh [PORT] [TOKEN_FILE]. Needs nc; with a local socket: nc -U SOCKET.
port=${1:-7000}
nc -z 127.0.0.1 "$port" || { echo "no service at 127.0.0.1:$port" >&2; exit 1; }
cat "${2:-$HOME/.local/state/stereo-sfm/token}" 2>/dev/null | nc 127.0.0.1 "$port" |
  sed -u 's/.*"unix_ns":\([0-9]*\).*"state":"\([A-Z]*\)".*"map_position":\[\([^]]*\)\].*/\1 \2 \3/'
