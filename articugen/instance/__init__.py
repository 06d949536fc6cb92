"""One object at one joint state: the story and its stages."""
