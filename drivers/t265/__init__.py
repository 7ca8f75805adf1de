"""The Intel RealSense T265 over USB, without the vendor SDK."""
