"""The paper's phantom and breathing experiments on data that users bring, and the files these come in."""
