"""The warm start: joints found from poses, and what is learned from them."""
