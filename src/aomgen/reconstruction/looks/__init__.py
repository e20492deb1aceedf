"""How the twin looks in every posture: the dressed arm, insides, what only the film shows."""
