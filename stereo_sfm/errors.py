"""The one error root of the project."""


class StereoSfmError(Exception):
    """Something the user can mend: bad input, calibration, configuration or device.

    The message is one line that says what is wrong and what to do. The command line prints it and exits with
    ``exit_code``; every other exception is an internal error and keeps its traceback.
    """

    exit_code = 2
