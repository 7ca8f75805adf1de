"""From keyframes to loops: vocabulary, database, verification, correction."""
