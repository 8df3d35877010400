"""Run records and the leaderboard generated from them (no torch, no simulator)."""
