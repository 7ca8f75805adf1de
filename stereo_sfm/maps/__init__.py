"""What saves, opens, merges, extends and relocalizes in maps that outlive a run."""
