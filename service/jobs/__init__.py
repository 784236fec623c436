"""Jobs: accepted, stored, queued, run. Knows neither HTTP nor pydantic."""
