"""Camera models, rigid transforms, triangulation and robust estimation: pure functions of arrays."""
