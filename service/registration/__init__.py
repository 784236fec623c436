"""Where on Earth a scene is, how large it is, and which way is up: registration of its world in a target frame.

    observations (photos and points with known places) -> consensus: which of them agree, and a start
        -> least squares: the similarity with covariance -> determined parts, refusals -> Registration -> a file

The target frame is in metres: the frame of the file that the known places are from, or East-North-Up of a point on
Earth. `observations` are values in, `registration` values out; `similarity_fit`, `consensus` and `determinacy` are the
solver, in numpy alone; the readers of known places are in `known_places/`, one file for each kind.
"""
