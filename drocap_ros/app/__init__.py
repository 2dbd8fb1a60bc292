"""``drocap app``: one page in a browser for clips, corrections and exports; every answer is a command's."""
