"""Worlds built in numpy and OpenCV, and what a vehicle's sensors record in them, with the truth known.

``world.build_world`` or ``street.build_street`` -> ``driving.plan_motion`` -> ``simulated_drive.simulate_drive``
(in memory) -> ``recording.record_drive`` (a file); ``scenario`` does all of it from a few numbers. ``rendering``
says what any camera or range sensor sees from any pose, and which point of the world is behind a pixel.
"""
