"""The hardware, real or simulated: geometry, mechanics, plant, drivers."""
