"""The paper's breathing experiment: an organ in two states of breath, less and less of it visible, and its vessels."""
