"""Views of what was made: tables in the terminal, pictures of the stored points."""
