"""Read videos of human hands: where both hands are in the picture stands for the action."""
