"""MuJoCo's XML, read without MuJoCo."""
