"""The operator's view in a browser: what to show is worked out here, viser only draws it."""
