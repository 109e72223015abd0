"""stub until merged"""


class ModalImpact:
    def __init__(self, **k):
        raise NotImplementedError
