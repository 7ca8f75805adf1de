"""One file per subcommand of `stereo-sfm`: `add_arguments(parser)` and `run(args) -> exit code`."""
