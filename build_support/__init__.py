"""How pgccd is compiled and packaged; not part of the installed package."""
