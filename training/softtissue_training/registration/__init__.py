"""Find how one surface moved to another where nobody says which point went where."""
