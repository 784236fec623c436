"""A live session: frames of a moving camera go in, a pose for each frame that was used comes out.

    newest frame (`mailbox`) -> decode -> extrapolated pose -> refine on one small render -> the gate by the pixels
    beside it, on a thread of lower priority: the whole gate every second; a search where tracking is lost

Where the device sends odometry, `fusion` places it in the scene and carries frames that have no pose of their own;
`odometry_fit` is the estimate, `odometry_scale` what is remembered of the scale.

`recent_views` keeps the frames that are searched for together, `live_values` has what goes in and out, `live_tracker`
the method, `background` the thread beside it, `pace` what the client is advised to send.
"""
