"""The suite `clouds`: organs as a stereo laparoscope sees them, as bare clouds in its frame."""
