"""What photon counts say about flux and range, and the limits that physics sets."""
