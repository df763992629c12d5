from softtissue_training.learning.run_log import CsvLog


def test_rows_that_a_lost_part_of_the_run_wrote_are_removed(tmp_path):
    path = tmp_path / "loss.csv"
    log = CsvLog(path, ("step", "loss"), 0)
    for step in range(1, 13):
        log.write((step, 1 / step))
    log.close()
    with path.open("a") as stream:
        stream.write("1")  # the beginning of step 13
    log = CsvLog(path, ("step", "loss"), 10)
    assert path.read_text().splitlines()[-1] == "10,0.1"
    log.write((11, 0.5))
    log.close()
    assert path.read_text().splitlines() == ["step,loss", *(f"{n},{1 / n}" for n in range(1, 11)), "11,0.5"]
    CsvLog(path, ("step", "loss"), 0).close()
    assert path.read_text() == "step,loss\n"
