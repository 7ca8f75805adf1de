"""What live cameras share: errors, counters, pairing of the eyes, clocks, hand-over to the consumer."""
