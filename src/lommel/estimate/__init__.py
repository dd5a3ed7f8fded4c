"""What is solved for: albedo, exposure, haze, surface."""
