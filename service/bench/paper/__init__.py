"""`splatfix bench paper`: the supplement's experiments on our scenes, and its tables and figures from the results."""
