"""Shared by live cameras: errors, counters, stereo pairing, clocks, buffers to the consumer."""
