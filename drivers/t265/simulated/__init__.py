"""A simulated T265: the protocol behind pyusb's backend interface, with configurable faults."""
