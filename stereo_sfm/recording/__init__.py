"""Recording a source to a file, and describing recordings."""
