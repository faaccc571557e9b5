"""How many control points, of which kernel and radius: gains of many setups, and one rule that chooses."""
