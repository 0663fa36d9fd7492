"""Reads a vehicle's UTM pose from its camera and the fleet's maps."""
