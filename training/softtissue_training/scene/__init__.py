"""The bundled scene: the phantom's liver, breathing and pushed, as a moving stereo laparoscope sees it."""
