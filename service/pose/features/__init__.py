"""What one image gives: resized copies, validity masks, local features, corners, in-plane rotation."""
