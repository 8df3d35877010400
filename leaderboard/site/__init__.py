"""Results and documentation as a folder of static pages, for any web server or none.

`board` knows what is shown and where, `charts` and `tables` turn the leaderboard's numbers into
what the pages hold, `pages` and `run_page` fill the templates, `build` writes the folder, `docs`
reads and builds the documentation. Nothing is computed here that `symsteer report` does not show.
"""
