from cgid.identification.model.model import Model as Model
