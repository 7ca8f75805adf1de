"""A T265 that needs no hardware: it speaks the protocol behind pyusb's backend interface, with faults to order."""
