"""Many robots and stores: versions of maps in a bucket, the work of a night, the catalogue (the extra `fleet`)."""
