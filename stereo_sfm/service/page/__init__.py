"""The operator's page: `server` is the output, `app` what a browser asks, `state` what it is shown."""
