"""What the 3D view draws, one class a layer. A layer is shown or hidden by its checkbox in the control panel."""
