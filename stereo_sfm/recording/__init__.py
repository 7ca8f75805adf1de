"""Writing any source to a recording, and describing one."""
