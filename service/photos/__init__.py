"""Photos, videos and sequences: encoded bytes to `Query`."""
