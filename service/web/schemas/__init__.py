"""The models of the HTTP API and their conversion from and to domain values."""
