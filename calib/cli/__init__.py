"""The command `calib`: one module a group of commands."""
