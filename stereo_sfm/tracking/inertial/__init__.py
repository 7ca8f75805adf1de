"""What an inertial sensor says of the motion: prediction, and the motion itself where images fail."""
