"""`symsteer compare A B`: what changed between two sets of finished runs, paired run by run.

`sides` finds the runs that A and B name, `pairing` pairs them, `changes` has the numbers and the
verdict, `output` and `figure` show them. The statistics are those of the leaderboard.
"""
