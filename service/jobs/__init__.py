"""Jobs: accepted, stored, queued, run. Knows neither HTTP nor pydantic.

Scenes are reached through the protocol `Engine` (engine.py); embedded_engine.py implements it with the scene manager of
this process, and is the only module here that imports more of `scene_manager` than its plain values and errors.
"""
