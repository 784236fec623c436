"""Which rendered views resemble a photo: the view index, its scores, and where its views are placed."""
