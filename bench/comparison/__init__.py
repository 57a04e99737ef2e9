"""pgccd beside other programs: one module a question, each with a function that measures all programs on one scene."""
