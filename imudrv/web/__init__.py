"""Pages for browsers: see `imudrv.web.server`."""
