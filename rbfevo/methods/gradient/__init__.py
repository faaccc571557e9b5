"""The search by gradients: quasi-Newton climbs that trace the front."""
