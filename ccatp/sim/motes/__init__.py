"""Pure. The true world of ultrasonic motes: where they are, what they hear, how long sound takes."""
