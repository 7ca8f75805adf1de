"""Everything that happened, as MCAP: topics, codec, writer, reader, diff."""
