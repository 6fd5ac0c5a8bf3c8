"""How much of each declared bound a recorded drive uses up, which bounds it contradicts, and which look too wide."""
