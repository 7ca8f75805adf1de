"""The operator's page: `server` is the output, `app` handles its requests, `state` holds what is shown."""
