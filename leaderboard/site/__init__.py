"""Results and documentation as a folder of static pages, for any web server or none.

`results` knows what is shown and where, `pages` and `run_page` fill the templates with it: sections
of the leaderboard's page (`markup`), its figures (`charts`), films and maps (`media`). `build`
writes the folder, with the `libraries` that browsers need and the documentation (`docs`). Nothing
is computed here that `symsteer report` does not show.
"""
